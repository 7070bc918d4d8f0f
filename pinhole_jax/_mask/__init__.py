"""What a mask says: its pixels, its edge, its levels, its signature and the views that look alike."""
