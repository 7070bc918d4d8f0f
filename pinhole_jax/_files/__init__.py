"""Files that are read with bounds and written whole: paths, pictures, EXIF, the compile cache."""
