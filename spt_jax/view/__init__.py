"""The live view: a body or a mesh in the browser, measured as it is moved."""
