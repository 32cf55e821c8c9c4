"""Pure geometry: rigid motions, cameras, meshes, planes, rays, outlines. Knows neither recordings nor recipes."""
