"""Relative poses to maps: everything that touches the graph (gtsam and scipy, never OpenCV)."""
