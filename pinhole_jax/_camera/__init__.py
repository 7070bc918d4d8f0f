"""The camera of Frisvad's note, its lens, and the way from film to rays and back."""
