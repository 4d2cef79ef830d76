"""Support relations (section III-A): contacts, support polygons, the relations, plausibility, removal."""
