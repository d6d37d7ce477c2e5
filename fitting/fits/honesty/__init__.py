"""What a fit says of its own errors."""
