"""Published obstacle avoidance methods, for comparison with ACFRA and RCAMO."""
