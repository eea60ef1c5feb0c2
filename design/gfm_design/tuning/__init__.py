"""The synthesis: free gains, searches, and the box that deployable gains must stabilise."""
