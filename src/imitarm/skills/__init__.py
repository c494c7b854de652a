"""What is learnt from demonstrations; knows nothing of obstacles."""
