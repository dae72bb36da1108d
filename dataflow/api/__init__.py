"""Recordings and graphs from Python and notebooks; `import dataflow` gives its names."""
