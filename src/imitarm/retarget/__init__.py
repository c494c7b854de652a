"""From a person's arm to a robot's arm: one method a file."""
