"""The robot's sensors: their errors, their times, and the messages that they give."""
