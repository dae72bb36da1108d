"""Looks at this machine and this installation for what a graph needs: the checks behind `dataflow doctor`."""
