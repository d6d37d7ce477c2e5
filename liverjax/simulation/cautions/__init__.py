"""Warnings about a run: mesh, contacts, pressures, volumes."""
