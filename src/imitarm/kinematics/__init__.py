"""How an arm, human or robot, moves."""
