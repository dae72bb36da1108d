"""Many recordings by many settings: each combination is run once, its outcome kept, and all become one table."""
