"""Basics of all folders: frozen structs, errors, status codes, names, files, versions, plotting."""
