"""What a fit adds to the keypoints: priors, joint limits, and what keeps a body from itself."""
