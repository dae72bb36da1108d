"""Starts the processes of a graph, watches over them, ends them."""
