"""Learners, one a file: which discrete action, with which parameters?"""
