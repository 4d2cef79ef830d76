"""The benchmark: methods compared over scenes, sensors and seeds, stored and drawn."""
