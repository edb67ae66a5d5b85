"""3D Gaussian splats: their projection, a differentiable rasterizer, images, and their training."""
