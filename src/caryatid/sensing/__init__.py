"""Camera data: views and clouds, normals, registration of views, the voxel map."""
