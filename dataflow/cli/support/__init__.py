"""Options, reports, tables and progress, shared by commands."""
