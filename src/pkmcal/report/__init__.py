"""Results of commands as outcomes: sentences, figures, tables, and the parts of their pages."""
