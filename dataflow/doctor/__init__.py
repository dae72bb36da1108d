"""What of this machine and this installation a graph needs, looked at: the checks behind `dataflow doctor`."""
