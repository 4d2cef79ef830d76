"""Objects over views: association, points, shapes, hidden extents, and the fusion of graphs."""
