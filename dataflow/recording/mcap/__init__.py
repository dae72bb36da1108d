"""The bytes of MCAP files: read, written, and read where they are torn."""
