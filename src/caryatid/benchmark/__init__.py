"""The benchmark: ways to look at clutter compared over scenes, sensors and seeds, stored and drawn."""
