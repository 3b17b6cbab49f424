"""What measures and shows the segmentation; a robot never imports it."""
