"""What the chapter shows and claims, reproduced."""
