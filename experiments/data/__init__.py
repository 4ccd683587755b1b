"""What experiments measure and train on."""
