"""What a mask says: its pixels, its edge and levels, and which views have such a signature."""
