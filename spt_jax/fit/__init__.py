"""Poses from keypoints: what a fit minimises, and the fit."""
