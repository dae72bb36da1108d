"""The causes of results that do not repeat, found by re-runs of one operator in which sources of chance are fixed."""
