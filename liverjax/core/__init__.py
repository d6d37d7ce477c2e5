"""What every room needs: frozen structs, errors, status codes, files, versions, plotting."""
