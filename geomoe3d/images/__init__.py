"""Two images: matches, relative pose and homography, and what a network needs to learn them."""
