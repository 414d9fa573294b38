"""What to measure next: what photographs would tell before they are taken, and the best choice."""
