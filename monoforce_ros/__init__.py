"""Robot–terrain interaction prediction: terrain from images or lidar, differentiable physics, and their evaluation."""
