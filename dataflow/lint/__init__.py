"""Looks for what is wrong with recorded data: gaps, timestamps, rates, the frame tree, clocks that disagree."""
