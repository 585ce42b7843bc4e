"""Output-error identification of servo models; calibration of joints and fleets."""
