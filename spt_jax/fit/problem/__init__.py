"""What a fit minimizes before any regularizer: people, a camera, and the terms of one person."""
