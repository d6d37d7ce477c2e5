"""Basics that all folders use: frozen structs, errors, status codes, names, files, versions, plotting."""
