"""What the triangles tell by themselves, exactly: who crosses whom, what lies in what, volume."""
