"""Delta printers: sessions made of what their firmware already holds."""
