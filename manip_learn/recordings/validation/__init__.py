"""Checks that recordings pass before they become demonstrations."""
