"""Synthetic worlds: a simulated robot drives over hills, rocks and soft grass, and its sensors fill a bag."""
