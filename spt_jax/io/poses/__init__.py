"""Pose files of every structure that is met: one module a family, one table of them all."""
