"""Discrepancy: finds where simulation and measurement disagree, and names the physics that is missing."""
