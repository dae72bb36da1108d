"""Commands that follow a running graph from another terminal, and give it messages and parameters."""
