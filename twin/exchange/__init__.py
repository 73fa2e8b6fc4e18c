"""File formats shared with other tools: GeoTIFF, GLB, and g2o and TORO pose graphs."""
