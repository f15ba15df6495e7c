"""Rigged characters: glTF's skins, morph targets and animations, read and written."""
