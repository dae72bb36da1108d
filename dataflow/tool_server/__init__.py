"""The commands that find the cause of a failure, as tools of coding agents over the Model Context Protocol."""
