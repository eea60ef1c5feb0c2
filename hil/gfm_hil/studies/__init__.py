"""Many runs for one question: campaigns, the comparison of laws, the box of real loops."""
