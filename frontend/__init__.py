"""Images to relative poses: everything that touches pixels (OpenCV and numpy, never gtsam)."""
