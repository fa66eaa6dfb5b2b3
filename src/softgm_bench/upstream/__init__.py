"""Replacements for parts of torch and TorchRL that are private or not meant to be replaced, each with its reason.

A new version of either library has to be tried here first.
"""
