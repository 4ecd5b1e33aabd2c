"""Where a target is: its box, the region searched for it, what stands out in images. Needs no model."""
