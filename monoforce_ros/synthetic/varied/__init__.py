"""Randomised worlds: everything that a network could learn by heart is drawn from wide ranges."""
