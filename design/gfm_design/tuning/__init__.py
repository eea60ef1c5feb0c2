"""The synthesis: free gains, searches, the box that deployable gains must hold."""
