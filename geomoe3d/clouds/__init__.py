"""From a file or an array to a cloud ready for description: reading, writing, preparation and features."""
