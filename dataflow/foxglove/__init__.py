"""Shows streams in Foxglove: as its own schemas, from a running graph or a recording, over its WebSocket."""
