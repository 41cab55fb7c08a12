"""Small files of other programs' formats, written by hand: one road, two lanes, a few road users."""

COMMONROAD_2018B = """<?xml version='1.0' encoding='UTF-8'?>
<commonRoad benchmarkID="XXX_Hand-1_1_T-1" commonRoadVersion="2018b" timeStepSize="0.5" author="us" date="2026-11-30" source="by hand" tags="">
  <lanelet id="1">
    <leftBound><point><x>0</x><y>2</y></point><point><x>50</x><y>2</y></point><lineMarking>dashed</lineMarking></leftBound>
    <rightBound><point><x>0</x><y>-2</y></point><point><x>25</x><y>-2</y></point><point><x>50</x><y>-2</y></point></rightBound>
    <successor ref="3"/>
    <successor ref="99"/>
    <adjacentLeft ref="2" drivingDir="same"/>
    <speedLimit>13.5</speedLimit>
  </lanelet>
  <lanelet id="2">
    <leftBound><point><x>0</x><y>6</y></point><point><x>50</x><y>6</y></point></leftBound>
    <rightBound><point><x>0</x><y>2</y></point><point><x>50</x><y>2</y></point></rightBound>
    <adjacentLeft ref="3" drivingDir="opposite"/>
    <adjacentRight ref="1" drivingDir="same"/>
  </lanelet>
  <lanelet id="3">
    <leftBound><point><x>50</x><y>2</y></point><point><x>99</x><y>2</y></point></leftBound>
    <rightBound><point><x>50</x><y>-2</y></point><point><x>99</x><y>-2</y></point></rightBound>
  </lanelet>
  <obstacle id="10">
    <role>dynamic</role><type>car</type>
    <shape><rectangle><length>4.5</length><width>1.8</width></rectangle></shape>
    <initialState>
      <position><point><x>5</x><y>0</y></point></position>
      <orientation><exact>0.1</exact></orientation>
      <time><exact>0</exact></time>
      <velocity><intervalStart>9</intervalStart><intervalEnd>11</intervalEnd></velocity>
    </initialState>
    <trajectory>
      <state>
        <position><rectangle><length>2</length><width>1</width><orientation>0</orientation><center><x>10</x><y>0</y></center></rectangle></position>
        <orientation><intervalStart>-0.1</intervalStart><intervalEnd>0.3</intervalEnd></orientation>
        <time><exact>1</exact></time>
        <velocity><exact>10</exact></velocity>
      </state>
    </trajectory>
  </obstacle>
  <obstacle id="11">
    <role>static</role><type>parkedVehicle</type>
    <shape><rectangle><length>4</length><width>2</width></rectangle></shape>
    <initialState><position><point><x>30</x><y>4</y></point></position><orientation><exact>0</exact></orientation><time><exact>0</exact></time></initialState>
  </obstacle>
  <obstacle id="12"><role>dynamic</role><type>train</type></obstacle>
  <planningProblem id="1"><initialState><position><point><x>0</x><y>0</y></point></position></initialState></planningProblem>
</commonRoad>
"""

COMMONROAD_2020A = """<?xml version='1.0' encoding='UTF-8'?>
<commonRoad benchmarkID="XXX_Hand-2_1_T-1" commonRoadVersion="2020a" timeStepSize="0.1" author="us" date="2026-11-30" source="by hand">
  <location><geoNameId>1</geoNameId></location>
  <scenarioTags><urban/></scenarioTags>
  <lanelet id="1">
    <leftBound><point><x>0</x><y>2</y></point><point><x>50</x><y>2</y></point></leftBound>
    <rightBound><point><x>0</x><y>-2</y></point><point><x>50</x><y>-2</y></point></rightBound>
    <laneletType>urban</laneletType>
    <trafficSignRef ref="7"/>
    <trafficLightRef ref="8"/>
  </lanelet>
  <trafficSign id="7"><trafficSignElement><trafficSignID>274</trafficSignID><additionalValue>8.33</additionalValue></trafficSignElement></trafficSign>
  <trafficLight id="8"><cycle/></trafficLight>
  <dynamicObstacle id="20">
    <type>bus</type>
    <shape><rectangle><length>12</length><width>2.5</width></rectangle></shape>
    <initialState><position><point><x>10</x><y>0</y></point></position><orientation><exact>0</exact></orientation><time><exact>0</exact></time><velocity><exact>5</exact></velocity></initialState>
    <trajectory>
      <state><position><point><x>10.5</x><y>0</y></point></position><orientation><exact>0</exact></orientation><time><exact>1</exact></time></state>
      <state><position><point><x>11.0</x><y>0</y></point></position><orientation><exact>0</exact></orientation><time><exact>2</exact></time></state>
    </trajectory>
  </dynamicObstacle>
  <dynamicObstacle id="21">
    <type>pedestrian</type>
    <shape><circle><radius>0.3</radius></circle></shape>
    <initialState><position><point><x>30</x><y>8</y></point></position><orientation><exact>1.5</exact></orientation><time><exact>0</exact></time><velocity><exact>1</exact></velocity></initialState>
    <trajectory><state><position><point><x>30</x><y>7.9</y></point></position><orientation><exact>1.5</exact></orientation><time><exact>1</exact></time><velocity><exact>1</exact></velocity></state></trajectory>
  </dynamicObstacle>
  <dynamicObstacle id="22"><type>car</type><shape><rectangle><length>4</length><width>2</width></rectangle></shape><occupancySet/></dynamicObstacle>
  <environmentObstacle id="30"><type>building</type><shape><polygon><point><x>20</x><y>5</y></point><point><x>25</x><y>5</y></point><point><x>25</x><y>9</y></point></polygon></shape></environmentObstacle>
</commonRoad>
"""

NET = """<?xml version="1.0" encoding="UTF-8"?>
<net version="1.20" junctionCornerDetail="5">
  <location netOffset="0,0" convBoundary="0,0,100,100" origBoundary="0,0,100,100" projParameter="!"/>
  <edge id=":J_0" function="internal"><lane id=":J_0_0" index="0" speed="8" length="10" shape="50,1.6 60,1.6"/></edge>
  <edge id=":J_w0" function="walkingarea"><lane id=":J_w0_0" index="0" allow="pedestrian" speed="1" length="1" shape="50,0 51,0"/></edge>
  <edge id="in" from="A" to="J">
    <lane id="in_0" index="0" allow="pedestrian" speed="13.89" length="50" width="2" shape="0,-1 50,-1"/>
    <lane id="in_1" index="1" speed="13.89" length="50" shape="0,1.6 50,1.6"/>
    <lane id="in_2" index="2" disallow="bus" speed="13.89" length="50" width="3" shape="0,4.7,0 50,4.7,1"/>
  </edge>
  <edge id="out" from="J" to="B"><lane id="out_0" index="0" speed="13.89" length="40" shape="60,1.6 100,1.6"/></edge>
  <tlLogic id="J" type="static" programID="0" offset="0"><phase duration="9" state="G"/></tlLogic>
  <junction id="J" type="traffic_light" x="55" y="0" incLanes="in_1" intLanes=":J_0_0" shape="50,0 60,0"/>
  <connection from="in" to="out" fromLane="1" toLane="0" via=":J_0_0" tl="J" linkIndex="0" dir="s" state="O"/>
  <connection from=":J_0" to="out" fromLane="0" toLane="0" dir="s" state="M"/>
</net>
"""

FCD = """<?xml version="1.0" encoding="UTF-8"?>
<fcd-export>
  <timestep time="0.00">
    <vehicle id="v" x="12.5" y="1.6" angle="90" type="lorry" speed="10" pos="7.5" lane="in_1" slope="0"/>
    <vehicle id="tram" x="12.5" y="50" angle="90" type="tram" speed="10" pos="7.5" lane="in_1" slope="0"/>
    <person id="p" x="20" y="-1" angle="0" speed="1" pos="20" edge="in" slope="0"/>
  </timestep>
  <timestep time="0.50">
    <vehicle id="v" x="17.5" y="1.6" angle="90" type="lorry" speed="10" pos="12.5" lane="in_1" slope="0"/>
    <vehicle id="u" x="0" y="4.7" angle="45" type="DEFAULT_VEHTYPE" speed="0" pos="0" lane="in_2" slope="0"/>
  </timestep>
</fcd-export>
"""

ROUTES = """<routes>
  <vType id="lorry" vClass="truck" length="8"/>
  <vTypeDistribution id="some"><vType id="tram" vClass="tram"/></vTypeDistribution>
  <vehicle id="v" type="lorry" depart="0"><route edges="in out"/></vehicle>
</routes>
"""

POLYGONS = """<additional>
  <poly id="house" type="building.yes" color="1,0,0" shape="20,10 30,10 30,20 20,10"/>
  <poly id="pond" type="water" shape="0,0 1,0 1,1"/>
  <poly id="far" type="building" geo="1" shape="9.1,48.1 9.2,48.1 9.2,48.2"/>
</additional>
"""

TRACKS = """frame,track,class,cx,cy,len,wid
0,a,Car,0,0,4.5,1.8
25,a,Car,32.8084,0,4.5,1.8
50,a,Car,65.6168,0,4.5,1.8
0,b,Tram,50,50,30,2
0,c,2,80,13.1234,,
25,c,2,80,13.1234,,
"""

LANES = """id,x_m,y_m,width_m,limit_mps,successors,left,right
1,0,0,3.5,13.9,3,2,
1,50,0,,,,,
2,0,4,3.5,,,,1
2,50,4,,,,,
3,50,0,,,,,
3,99,0,,,,,
"""

BUILDINGS = """building,x_m,y_m
h,20,10
h,30,10
h,30,20
"""
