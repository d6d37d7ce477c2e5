"""What is attached to a body: elements of their own between its nodes."""
