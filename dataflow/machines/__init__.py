"""One graph on several machines: the link between them, the agent on each, and the keys that let them in."""
