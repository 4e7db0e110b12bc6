"""Learned curves in words: the simplest known shape that explains a function without a form."""
