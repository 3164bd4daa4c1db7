"""Selectors, one a file: which option?"""
