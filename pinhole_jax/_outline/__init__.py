"""What errors a mask's outline has, as a view shows them."""
