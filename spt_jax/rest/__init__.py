"""The surface at rest: distances along it and the local thickness, which identify folds."""
