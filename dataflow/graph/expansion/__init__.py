"""From graph files to one flat list of operators."""
