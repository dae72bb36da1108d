"""Calibration of cameras, stereo pairs and cameras beside IMUs, from recordings of a board."""
