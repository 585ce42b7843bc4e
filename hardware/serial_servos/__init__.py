"""What serial servos of every vendor share: line, registers, opening, scan and bus."""
