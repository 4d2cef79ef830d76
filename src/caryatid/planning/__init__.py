"""Active vision (section IV): points of interest, candidate views, and the next-best-view planners."""
