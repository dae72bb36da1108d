"""Tools outside a running graph."""
