"""What happens when objects are taken away, and in which order that is safe."""
