"""One operator, without processes: its calls, its ports, its log."""
