"""Formats of files of waves, and phases made continuous."""
