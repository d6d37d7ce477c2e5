"""What every room needs: frozen structs, errors, status codes, names, files, versions, plotting."""
