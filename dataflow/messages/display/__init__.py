"""Messages and arrays for people: text, HTML, pictures."""
