"""Robots that carry the camera: the protocol, a humanoid, an arm, a recording played back."""
