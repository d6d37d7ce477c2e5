"""Reproductions of what the chapter shows and claims."""
