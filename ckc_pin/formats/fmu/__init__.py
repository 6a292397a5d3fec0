"""Write a scene as a functional mock-up unit (FMI 2.0 and 3.0), for Simulink, Dymola, OpenModelica and others."""
