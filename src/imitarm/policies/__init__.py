"""How a skill is reproduced around obstacles, one method a file."""
