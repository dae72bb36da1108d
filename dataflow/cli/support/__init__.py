"""What commands share: options, reports, tables, progress."""
