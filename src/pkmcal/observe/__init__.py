"""Images to measurements. The only package besides cameras/ that uses cv2."""
