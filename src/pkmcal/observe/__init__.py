"""Photographs to measurements. The only place besides cameras/ that touches cv2."""
