"""Messages of recordings: codecs, columns, readers and writers."""
