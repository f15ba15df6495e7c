"""Data that comes with the package; README.md here says where it is from."""
