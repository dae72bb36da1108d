"""The limits of a recording: one table, which the writer keeps to and the reader refuses to go beyond.

They bound the memory and the time of one step against a file made to do harm; none bounds the length of a recording.
"""

from __future__ import annotations

MAX_CHUNK_BYTES = 2**29
"""A message with what is derived from it, a firing record, an event, a chunk (uncompressed), an attachment."""
MAX_EFFECT_BYTES = 2**24
"""Answers of one firing's effects, so that a batch of firing records stays small; a larger answer is an error."""
MAX_RECORD_BYTES = 2**28
"""A schema, a channel, a metadata record, a message index: more than any graph or schema takes."""
MAX_CHUNK_MESSAGES = 2**20
"""Messages of one chunk, so that its message indexes stay below `MAX_RECORD_BYTES`; the writer begins a new one."""
MAX_CHANNELS = 65535
"""Channels of one file: MCAP numbers them so."""
MAX_PARSED = 2**18
"""Schemas, channels, metadata records and attachments of one file: each costs some 20 µs to read."""

UNINDEXED_RECORDS = 2**23
"""Records that are looked for without an index in a file of any size: each costs a microsecond or two."""
BYTES_PER_RECORD = 8
"""Bytes of a file for each further one of them; a message takes more, however well it compresses."""
UNINDEXED_BYTES = 2**31
"""Expanded bytes of another program's chunks without an index whose ratio is not looked at."""
MAX_RATIO = 300
"""Ratio of further ones: beyond what LZ4 can do and what zstd does on sensor data."""
LIKELY_RATIO = 32
MAX_IN_VAIN = 2**29
"""Bytes beyond that ratio to which chunks of another program may expand and then not be read, before all is refused."""
