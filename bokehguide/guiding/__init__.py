"""Guided lens sampling: the strategies that learn, and their parts."""
