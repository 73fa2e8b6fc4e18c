"""Rows of the arrays (N_ROWS, W) float32 in which `floor_albedo` and `triplanar` compute the pixels of an image row.

Positions are measured east and north from the south-west corner of the floor, and down from its highest point [m].
"""

COLUMN, DEPTH = 0, 1  #: column from the middle of the image [px], depth [m]
FALL_X, FALL_Y = 2, 3  #: slope of the facet: fall towards east and north
EAST, NORTH, BELOW = 4, 5, 8  #: position [m]
COL, ROW = 6, 7  #: position in the cell, 0 to 1
#: displacement on the facet to the next pixel along rows and columns of the image, east, north and down [m]
ACROSS_X, ACROSS_Y, ACROSS_Z, DOWN_X, DOWN_Y, DOWN_Z = 9, 10, 11, 12, 13, 14
LEVEL = 15  #: level of resolution of the texture
WEIGHT_X, WEIGHT_Y = 16, 17  #: signed weights of the textures projected along x and y
MAJOR_ALONG, MAJOR_BELOW, SAMPLES = 18, 19, 20  #: step between the samples of a footprint [texels], and their number
AT_X, AT_Y, AT_LEVEL, SHARE = 21, 22, 23, 24  #: column, row, level and weight of listed samples
SPARE = 25  #: first of three rows of `texture_levels.add_samples`
N_ROWS = 28
