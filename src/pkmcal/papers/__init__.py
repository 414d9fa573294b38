"""The papers' own methods: each an equation's function, as printed and corrected."""
