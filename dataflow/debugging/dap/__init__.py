"""Serves an editor's debugger: the Debug Adapter Protocol (DAP), with time that runs back."""
