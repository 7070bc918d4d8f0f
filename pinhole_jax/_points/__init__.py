"""Views of points whose places in the world are known: calibration, and poses."""
