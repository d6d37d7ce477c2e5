"""Numerical evidence: one script for each question, the results of the scripts, and the pages that quote these
results.
"""
