"""What commands found, as outcomes: sentences, figures, tables, and the parts of their pages."""
