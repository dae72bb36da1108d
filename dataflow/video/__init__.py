"""H.264 and H.265 packets: which can be decoded, and their pixels."""
