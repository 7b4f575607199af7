"""Whether a result is good enough: rules, what they compare, and the judgement."""
