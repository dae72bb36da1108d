"""The error-state filter of a body: its state, measurement models, gates, and measurements in any order."""
