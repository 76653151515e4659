"""Generated rooms: what stands in them, how a camera walks through and what its sensor makes of them."""
