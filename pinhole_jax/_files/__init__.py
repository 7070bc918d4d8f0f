"""Files that are read with bounds and written whole: paths, pictures, EXIF, programs that are kept;
what an interrupt does to them."""
