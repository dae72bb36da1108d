"""Hard operators, and the verdict that is right for each."""
