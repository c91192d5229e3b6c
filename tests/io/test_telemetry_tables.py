"""Tables of other programs: each by its columns, their units and what they count from; what is not sure is said."""

import math
from typing import Any, cast

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.fields import Names

NOON_UTC_S = 1661515200.0  # 2022-08-26 12:00:00
PLACE = "time_s,lat,lon,relative_altitude"


def table(header: str, row: str, count: int = 4) -> str:
    return "\n".join([header, *(row.format(i=i) for i in range(count))]) + "\n"


def check(flown, **wanted) -> None:
    """Compare the last sample, and the record, with the right values; angles in degrees, None for unknown."""
    columns = {
        "altitude": flown.altitude_m,
        "sea": flown.above_sea_m,
        "ellipsoid": flown.above_ellipsoid_m,
        "speed": flown.speed_m_s,
        "longitude": flown.place[:, 0],
        "latitude": flown.place[:, 1],
        "heading": np.degrees(flown.heading_rad),
        "pitch": np.degrees(flown.pitch_rad),
        "roll": np.degrees(flown.roll_rad),
        "nose": np.degrees(flown.vehicle_heading_rad),
        "hfov": np.degrees(flown.hfov_rad),
    }
    for name, value in wanted.items():
        if name == "times":
            np.testing.assert_allclose(flown.time_s[: len(value)], value, atol=1e-5)
        elif name == "zero":
            assert flown.height_zero == value
        elif name == "start":
            np.testing.assert_allclose(flown.start_utc_s, math.nan if value is None else value, atol=1e-3)
        else:
            right = math.nan if value is None else value
            np.testing.assert_allclose(columns[name][-1], right, atol=2e-3, err_msg=f"{name}; notes: {flown.notes}")


PROGRAMS = {
    "AirData in feet": (
        table(
            "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),"
            "height_above_ground_at_drone_location(feet),altitude_above_seaLevel(feet),speed(mph),"
            " compass_heading(degrees), pitch(degrees),gimbal_heading(degrees),gimbal_pitch(degrees),altitude(feet),"
            "ascent(feet)",
            "{i}00,2022-08-26 12:00:00,41.6,-91.5,164.042,200,820.21,10,9,-5,350,-60,820.21,164.042",
        ),
        {
            "times": [0, 0.1, 0.2, 0.3],
            "start": NOON_UTC_S,
            "altitude": 50,
            "zero": "takeoff",
            "sea": 250,
            "speed": 4.4704,
            "nose": 9,
            "heading": 350,
            "pitch": 60,
        },
    ),
    "AirData with ascent and altitude alone": (
        table("time(millisecond),datetime(utc),latitude,longitude,altitude(m),ascent(m)", "{i}00,2022-08-26 12:00:00,41,-91,250,50"),  # noqa: E501
        {"altitude": 50, "sea": 250, "start": NOON_UTC_S},
    ),
    "Litchi": (
        table(
            "latitude,longitude,altitude(ft),speed(mph),gimbalPitchRaw,gimbalYawRaw,time(millisecond),datetime(utc),"
            "isTakingVideo",
            "39.5,-105.2,196.85,10,-600,531,{i}000,2022-08-26 12:00:0{i}.500,1",
        ),
        {"altitude": 60, "zero": "takeoff", "sea": None, "pitch": 60, "heading": 53.1, "start": NOON_UTC_S + 0.5},
    ),
    "a flight record in decimal commas": (
        "sep=;\n"
        + table(
            "CUSTOM.date [local];CUSTOM.updateTime [local];OSD.flyTime;OSD.flyTime [s];OSD.latitude;OSD.longitude;"
            "OSD.height [ft];OSD.altitude [ft];OSD.hSpeed [MPH];OSD.yaw [360];GIMBAL.pitch;GIMBAL.yaw;CAMERA.isVideo",
            "26.08.2022;12:00:00,{i} pm;0m 0,{i}s;0,{i};41,6;-91,5;164,042;820,21;22,3694;350,0;-60,0;-10,0;True",
        ),
        {
            "times": [0, 0.1, 0.2, 0.3],
            "start": None,
            "latitude": 41.6,
            "longitude": -91.5,
            "altitude": 50,
            "sea": 250,
            "speed": 10,
            "pitch": 60,
            "heading": 350,
            "nose": 350,
        },
    ),
    "a flight log service": (
        table(
            "time_s,lat,lng,alt_m,height_m,vps_height_m,altitude_m,speed_ms,pitch,roll,yaw,gimbal_pitch,gimbal_yaw",
            "{i},35.1,-110.4,40,40,39.5,1540,3,-5,0,90,-60,95",
        ),
        {"altitude": 40, "zero": "takeoff", "sea": 1540, "speed": 3, "nose": 90, "heading": 95, "pitch": 60, "roll": None},  # noqa: E501
    ),
    "QGroundControl": (
        table(
            "Timestamp,roll,pitch,heading,groundSpeed,altitudeRelative,altitudeAMSL,gps.lat,gps.lon,"
            "gps.courseOverGround,setpoint.yaw,clock.currentTime",
            "2022-08-26 12:00:0{i}.500,1,2,90,--.--,50,550,48.1,11.5,88,0,12:00:0{i}",
        ),
        {"altitude": 50, "sea": 550, "nose": 90, "pitch": None, "speed": None, "latitude": 48.1, "start": None},
    ),
    "DroneDeploy with lines before and after": (
        "#DroneDeploy\t2.1.0\nSession ID\t587\nDevice Model\tiPhone\n\n"
        + table(
            "Date/Time (UTC)\tElapsed Time (sec)\tInfo\tDevice Latitude (Degrees)\tAircraft Latitude (Degrees)\t"
            "Aircraft Longitude (Degrees)\tAircraft Speed (mph)\tAircraft Barometric Altitude (ft)\t"
            "Aircraft Heading (Degrees)\tHome Latitude (Degrees)\tGimbal Pitch (Degrees)\tGimbal Yaw (Degrees)",
            "08/26/2022 12:00:00\t0.{i}69\tx\t1\t37.7\t-122.4\t10\t164.042\t33.1\t37\t-60\t33.9",
        )
        + "#Session End\nDate/Time (UTC)\t08/26/2022 12:01:00\n",
        {"times": [0, 0.1], "altitude": 50, "latitude": 37.7, "nose": 33.1, "heading": 33.9, "start": NOON_UTC_S - 0.069},  # noqa: E501
    ),
    "SkyHub": (
        table(
            "Elapsed,Date,Time,Pitch,Roll,Yaw,Latitude,Longitude,Altitude,Velocity,RTK Status,Latitude RTK,Altitude RTK",  # noqa: E501
            "{i}00,2022/08/26,12:00:00.{i}00,1,2,90,56.9,24.1,20,3,OFF,0,0",
        ),
        {"times": [0, 0.1], "altitude": 20, "zero": "takeoff", "nose": 90, "speed": 3, "latitude": 56.9},
    ),
    "EdgeTX": (
        table("Date,Time,GPS,Alt(m),Yaw(rad),Hdg(@),GSpd(kts)", "2022-08-26,12:00:0{i}.000,48.1 11.5,50,1.5708,10,10"),
        {"latitude": 48.1, "longitude": 11.5, "altitude": None, "zero": "unknown", "sea": 50, "nose": 90, "speed": 5.144},  # noqa: E501
    ),
    "ulog2csv, long after the start": (
        table(
            "timestamp,lat,lon,alt,alt_ellipsoid,delta_alt,eph,epv",
            "11125{i}4307,47.3977420,8.5455950,488.08,535.0,0,0.5,0.8",
        ),
        {"times": [0, 0.01, 0.02], "sea": 488.08, "ellipsoid": 535, "altitude": None, "start": None},
    ),
    "ulog2csv of an old receiver": (
        table(
            "timestamp,time_utc_usec,lat,lon,alt,alt_ellipsoid,s_variance_m_s,fix_type,vel_m_s",
            "7{i}00000,16615152000{i}0000,473977420,85455950,488080,535000,0.5,3,1.5",
        ),
        {"latitude": 47.397742, "longitude": 8.545595, "sea": 488.08, "ellipsoid": 535, "speed": 1.5, "start": NOON_UTC_S},  # noqa: E501
    ),
    "ulog2csv of a new receiver": (
        table(
            "timestamp,timestamp_sample,latitude_deg,longitude_deg,altitude_msl_m,altitude_ellipsoid_m,time_utc_usec,vel_m_s",
            "7{i}00000,0,47.397742,8.545595,488.08,535,16615152000{i}0000,1.5",
        ),
        {"latitude": 47.397742, "sea": 488.08, "ellipsoid": 535, "times": [0, 0.01], "start": NOON_UTC_S},
    ),
    "ulog2csv of the local position": (
        table("timestamp,timestamp_sample,x,y,z,heading,ref_lat,xy_valid", "7{i}20000,0,1,2,-30,1.5708,47.4,1"),
        {"altitude": 30, "zero": "takeoff", "nose": 90, "times": [0, 0.1]},
    ),
    "mavlogdump POS": (
        table("timestamp,TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt", "1661515200.{i},8{i}00000,-35.36,149.16,584.4,-0.26,-1.2"),  # noqa: E501
        {"altitude": -0.26, "zero": "takeoff", "sea": 584.4, "times": [0, 0.1], "start": NOON_UTC_S},
    ),
    "mavlogdump GPS": (
        table("timestamp,TimeUS,Status,Lat,Lng,Alt,Spd,GCrs", "1661515200.{i},8{i}00000,3,-35.36,149.16,588.8,0.2,36"),
        {"speed": 0.2, "sea": 588.8, "nose": None, "latitude": -35.36},
    ),
    "mavlogdump MNT": (
        table("timestamp,TimeUS,I,DesRoll,Roll,DesPitch,Pitch,DesYawE,YawE", "1661515200.{i},8{i}00000,0,0,1,-45,-44,0,95"),  # noqa: E501
        {"pitch": 44, "roll": 1, "heading": 95, "nose": None},
    ),
    "mavlogdump BARO": (
        table("timestamp,TimeUS,I,Alt,Press", "1661515200.{i},8{i}00000,0,12.5,94000"),
        {"altitude": 12.5, "zero": "takeoff", "sea": None},
    ),
    "mavlogdump of a tlog with two messages": (
        table(
            "timestamp,GLOBAL_POSITION_INT.time_boot_ms,GLOBAL_POSITION_INT.lat,GLOBAL_POSITION_INT.lon,"
            "GLOBAL_POSITION_INT.alt,GLOBAL_POSITION_INT.relative_alt,VFR_HUD.groundspeed,VFR_HUD.alt",
            "1661515200.{i}00,8{i}00,-353626277,1491653034,588820,4820,,\n1661515200.{i}50,,,,,,6,588.8",
        ),
        {"altitude": None, "times": [0, 0.05, 0.1], "start": NOON_UTC_S},
    ),
    "INAV": (
        table(
            "time (us), GPS_coord[0], GPS_coord[1], GPS_altitude, GPS_speed (m/s), baroAlt (cm), heading (deg)",
            "1{i}00000, 47.1, 8.2, 1234, 5.5, 1234, 90.1",
        ),
        {"latitude": 47.1, "longitude": 8.2, "altitude": 12.34, "sea": None, "speed": 5.5, "nose": 90.1},
    ),
    "DatCon": (
        table(
            "Clock:Tick#,Clock:offsetTime,GPS(0):Lat,GPS(0):Long[degrees [-180;180]],GPS(0):heightMSL,"
            "IMU_ATTI(0):relativeHeight:C,IMU_ATTI(0):yaw:C,IMU_ATTI(0):velH:C",
            "{i},10{i}.5,39.0,116.0,70,10,90,2",
        ),
        {"times": [0, 1], "latitude": 39, "longitude": 116, "sea": 70, "altitude": 10, "nose": 90, "speed": 2},
    ),
    "Parrot's metadata": (
        table(
            "time_s,location_latitude,location_longitude,location_altitude_egm96amsl,location_altitude_wgs84ellipsoid,"
            "ground_distance,picture_hfov",
            "{i},47.1,8.2,500,547,30,69",
        ),
        {"altitude": 30, "zero": "ground", "sea": 500, "ellipsoid": 547, "hfov": 69},
    ),
    "MAVLink's GPS_RAW_INT": (
        table("time_usec,fix_type,lat,lon,alt,eph,epv,vel,cog", "12{i}00000,3,481371000,115753000,12000,80,90,200,45"),
        {"sea": 12, "speed": 2, "latitude": 48.1371, "longitude": 11.5753, "times": [0, 0.1]},
    ),
    "MAVLink's GPS_RAW_INT with prefixes": (
        table("timestamp,GPS_RAW_INT.lat,GPS_RAW_INT.lon,GPS_RAW_INT.alt,GPS_RAW_INT.vel", "166151520{i}.0,481371000,115753000,540000,500"),  # noqa: E501
        {"sea": 540, "speed": 5, "latitude": 48.1371, "start": NOON_UTC_S},
    ),
    "MAVLink's MOUNT_ORIENTATION": (
        table("timestamp,MOUNT_ORIENTATION.roll,MOUNT_ORIENTATION.pitch,MOUNT_ORIENTATION.yaw,MOUNT_ORIENTATION.yaw_absolute", "166151520{i}.0,1,-60,10,90"),  # noqa: E501
        {"roll": 1, "pitch": 60, "heading": 90, "nose": None},
    ),
    "u-blox NAV-PVT": (
        table("iTOW,lon,lat,height,hMSL,gSpeed,headMot", "{i}00,115753000,481371000,588000,540000,5000,45"),
        {"sea": 540, "ellipsoid": 588, "speed": 5, "latitude": 48.1371, "times": [0, 0.1]},
    ),
    "Skydio": (
        table(
            "timestamp,latitude,longitude,hae,height_above_takeoff,gimbal_pitch,vehicle_heading",
            "2022-08-26T12:00:0{i}.000Z,37.5,-122.3,120,50,-45,90",
        ),
        {"altitude": 50, "ellipsoid": 120, "sea": None, "pitch": 45, "nose": 90, "start": NOON_UTC_S},
    ),
    "UgCS": (
        table("Time,Latitude,Longitude,Altitude RAW,Altitude AMSL (m),Altitude [AGL]", "2022-08-26T12:00:0{i}Z,37,-122,50,150,45"),  # noqa: E501
        {"altitude": 45, "zero": "ground", "sea": 150},
    ),
    "the fields of a subtitle": (
        table(
            "frame,timestamp,fnum,focal_len,latitude,longitude,rel_alt,abs_alt,dzoom_ratio",
            "{i},2022-08-26 12:00:00.{i}00,2.8,24.0,37.4,126.7,146,94,20000",
        ),
        {"times": [0, 0.1], "altitude": 146, "sea": 94, "hfov": 41.112},
    ),
}  # fmt: skip


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_columns_of_a_program_have_its_units_and_zero_points(fly, program):
    text, wanted = PROGRAMS[program]
    check(fly(text), **cast(dict[str, Any], wanted))


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        ("# made by x, y, z\n# version 2\n{}", (11.5, 48.1)),
        ("\n{}", (11.5, 48.1)),
        ("# {}", (11.5, 48.1)),
        ("made on,2022-08-26\nby,me\n\n{}", (11.5, 48.1)),
        ('{},"a note\nof two lines"', (11.5, 48.1)),
    ],
)
def test_lines_before_the_names_and_quoted_line_feeds_are_no_rows(fly, lines, place):
    row = '{i},48.1,11.5,50,"a\nb"'
    flown = fly(table(lines.format(PLACE), row))
    assert len(flown) == 4 and flown.place[-1].tolist() == list(place)


def test_a_line_of_units_below_the_names_counts(fly):
    flown = fly("time,lat,lon,height agl,speed\n" + table("ms,deg,deg,ft,kn", "{i}00,48.1,11.5,164.042,10"))
    check(flown, times=[0, 0.1], altitude=50, zero="ground", speed=5.144)


def test_names_that_come_again_are_no_rows_and_other_rows_without_a_time_are_noted(fly):
    flown = fly(table(PLACE, "{i},48.1,11.5,50") + table(PLACE, "{i}0,48.1,11.5,50") + "the end\n")
    assert flown.time_s.tolist() == [0, 1, 2, 3, 10, 20, 30]
    assert [note for note in flown.notes if "line 11: 'the end' is not a time; 1 rows" in note]


def test_a_number_that_no_clock_counts_to_is_no_time(fly):
    flown = fly("time_s,lat,lon,x\n-1e308,48.1,11.5,\n" + table("0,48.1,11.5,", "{i},48.1,11.5,"))
    assert flown.time_s.tolist() == [0, 1, 2, 3]
    assert [note for note in flown.notes if "line 2: '-1e308' is not a time; 1 rows" in note]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_of_rows_within_a_microsecond_the_last_counts(fly):
    flown = fly("time_s,lat,lon,x\n0,48.1,11.5,\n5e-324,40.1,1.5,\n1,40.1,1.5,\n2,40.1,1.5,\n")
    np.testing.assert_allclose(flown.time_s, [0, 1, 2], atol=1e-9)
    np.testing.assert_array_equal(flown.place, [[1.5, 40.1]] * 3)


# -- Times -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "cells", "times", "start"),
    [
        ("date,time", ["26/08/2022,11:59:59.5 AM", "26/08/2022,12:00:00 PM"], [0, 0.5], None),
        ("time,date (utc)", ["12:00:00,26/08/2022", "12:00:01,26/08/2022"], [0, 1], NOON_UTC_S),
        ("datetime(utc)", ["26.08.2022 12:00:00", "26.08.2022 12:00:01"], [0, 1], NOON_UTC_S),
        ("datetime(utc)", ["8/26/2022 12:00:00 PM", "8/26/2022 12:00:01 PM"], [0, 1], NOON_UTC_S),
        ("datetime [UTC]", ["05/08/2022 23:59:59", "06/08/2022 00:00:00"], [0, 1], 1659743999),
        ("timestamp", ["2022-08-26T14:00:00+02:00", "2022-08-26T14:00:01+0200"], [0, 1], NOON_UTC_S),
        ("timestamp", ["1661515200", "1661515201"], [0, 1], NOON_UTC_S),
        ("timestamp", ["1661515200000", "1661515200100"], [0, 0.1], NOON_UTC_S),
        ("epoch_ms", ["1661515200000", "1661515200100"], [0, 0.1], NOON_UTC_S),
        ("timestamp", ["1661515200000000", "1661515200100000"], [0, 0.1], NOON_UTC_S),
        ("time", ["23:59:59.5", "00:00:00.5"], [0, 1], None),
        ("flight time", ["12:59.5", "13:00.5"], [0, 1], None),
        ("flyTime", ["0m 59.9s", "1m 0.1s"], [0, 0.2], None),
        ("elapsed", ["1h 0m 0s", "1h 0m 1s"], [0, 1], None),
        ("TimeUS", ["1000000", "1100000"], [0, 0.1], None),
        ("time (ms)", ["1000", "1100"], [0, 0.1], None),
        ("time_boot_ms", ["1000", "1100"], [0, 0.1], None),
        ("seconds", ["7", "8"], [0, 1], None),
        ("time", ["44799.5", "44799.500005787037", "44799.500011574074"], [0, 0.5, 1], None),
        ("datetime(utc)", ["44799.5", "44799.500011574074", "44799.500023148148"], [0, 1, 2], NOON_UTC_S),
        ("t (utc)", ["738759.5", "738759.5000115741", "738759.5000231481"], [0, 1, 2], NOON_UTC_S),  # MATLAB
        ("time", ["0.75", "0.75001157407407", "0.75002314814815"], [0, 1, 2], None),
        ("utc_time", ["181259.0", "181259.5", "181300.0"], [0, 0.5, 1], None),
        ("time", ["095959", "100000", "100001"], [0, 1, 2], None),
        ("utc", ["235959", "000000", "000001"], [0, 1, 2], None),
        ("time", ["181259500", "181300000", "181300500"], [0, 0.5, 1], None),
        (
            "date,time (utc)",
            ["20220826,115959.5", "20220826,120000.0", "20220826,120000.5"],
            [0, 0.5, 1],
            NOON_UTC_S - 0.5,
        ),
        ("timestamp (utc)", ["20220826120000", "20220826120001", "20220826120002"], [0, 1, 2], NOON_UTC_S),
        ("timestamp", ["20220826T120000Z", "20220826T120001Z"], [0, 1], NOON_UTC_S),
        ("timestamp (utc)", ["20220826 12:00:00.5", "20220826 12:00:01"], [0, 0.5], NOON_UTC_S + 0.5),
        ("datetime(utc)", ["26-Aug-2022 12:00:00", "26-Aug-2022 12:00:01"], [0, 1], NOON_UTC_S),
        ("datetime(utc)", ['"Aug 26, 2022 12:00:00 PM"', '"Aug 26, 2022 12:00:01 PM"'], [0, 1], NOON_UTC_S),
        ("datetime(utc)", ["Fri Aug 26 12:00:00 2022", "Fri Aug 26 12:00:01 2022"], [0, 1], NOON_UTC_S),
        ("datetime(utc)", ["26/08/22 12:00:00", "26/08/22 12:00:01"], [0, 1], NOON_UTC_S),
        ("datetime(utc)", ["2022:08:26 12:00:00", "2022:08:26 12:00:01"], [0, 1], NOON_UTC_S),
        ("timestamp", ["2022-08-26T14:00:00+02", "2022-08-26T14:00:01+02"], [0, 1], NOON_UTC_S),
        ("timestamp", ["2022-08-26 14:00:00.5 CEST", "2022-08-26 14:00:01 CEST"], [0, 0.5], NOON_UTC_S + 0.5),
        ("timestamp", ["2022-08-26 14:00:00 UTC+2", "2022-08-26 14:00:01 UTC+2"], [0, 1], NOON_UTC_S),
        ("flight time", ["0 ms", "500 ms", "1000 ms"], [0, 0.5, 1], None),
        ("flight time", ["1 min 59.5 s", "2 min 0 s"], [0, 0.5], None),
        ("time", ["PT0.5S", "PT1M0.5S"], [0, 60], None),
        ("time (min)", ["0.000", "0.008333", "0.016667"], [0, 0.49998, 1.00002], None),
        ("time_h", ["0", "0.00027777778", "0.00055555556"], [0, 1, 2], None),
        (
            "secs,nsecs",
            ["1661515200,0", "1661515200,500000000", "1661515201,0", "1661515201,500000000"],
            [0, 0.5, 1, 1.5],
            NOON_UTC_S,
        ),
        ("sec,nanosec", ["7,900000000", "8,100000000", "8,300000000"], [0, 0.2, 0.4], None),
    ],
)
def test_times_are_read_in_every_form(fly, name, cells, times, start):
    rows = "".join(f"{cell},48.1,11.5,50\n" for cell in cells)
    flown = fly(f"{name},lat,lon,relative_altitude\n{rows}")
    check(flown, times=times, start=start)
    assert len(flown) >= len(cells) and np.isfinite(flown.place[-1]).all()


@pytest.mark.parametrize(
    ("cells", "times"),
    [
        ([10, 10, 11, 11, 12, 12], [0, 0.5, 1, 1.5, 2, 2.5]),
        ([10, 10, 10, 11, 11, 11], [0, 1 / 3, 2 / 3, 1, 4 / 3, 5 / 3]),
        ([10, 11, 11, 12, 12, 13, 13], [0, 0.5, 1, 1.5, 2, 2.5, 3]),  # the log begins within a second
    ],
)
def test_rows_that_share_a_coarse_time_are_spread_over_it_with_a_note(fly, cells, times):
    rows = "".join(f"2022-08-26 12:00:{cell},48.1,11.5,{k}\n" for k, cell in enumerate(cells))
    flown = fly("datetime(utc),lat,lon,relative_altitude\n" + rows)
    np.testing.assert_allclose(flown.time_s, times, atol=1e-6)
    assert flown.altitude_m.tolist() == list(range(len(cells)))
    assert [note for note in flown.notes if "they are spread evenly over it" in note]


@pytest.mark.parametrize(
    ("step", "note"),
    [
        (1, None),
        (0.1, None),
        (100, "'timestamp' is taken to be in milliseconds, by its steps of 100"),
        (100_000, "'timestamp' is taken to be in microseconds, by its steps of 100000"),
        (5, "'timestamp' is taken to be in seconds, by its steps of 5"),
    ],
)
def test_a_unit_that_the_name_does_not_say_follows_from_the_steps_and_is_noted(fly, step, note):
    rows = "".join(
        f"{1_112_000_000 + k * step:g},48.1,11.5,50\n" if step > 999 else f"{k * step},48.1,11.5,50\n" for k in range(5)
    )
    flown = fly(f"timestamp,lat,lon,relative_altitude\n{rows}")
    scale = {100: 1e-3, 100_000: 1e-6}.get(step, 1.0)
    np.testing.assert_allclose(np.diff(flown.time_s), step * scale, rtol=1e-6)
    assert [text for text in flown.notes if "taken to be in" in text] == ([] if note is None else [note])


def test_the_dates_and_the_speed_of_the_vehicle_tell_the_unit_of_times(fly):
    dated = "".join(f"{5000 * k},2022-08-26 12:00:{5 * k:02d},48.1,11.5,50\n" for k in range(5))
    check(fly("t,datetime,lat,lon,relative_altitude\n" + dated), times=[0, 5, 10])
    rows = "".join(f"{30 * k},{48.1 + k * 1e-3:.4f},11.5,50\n" for k in range(5))  # 111 m in 30 s, not in 30 ms
    check(fly("t,lat,lon,relative_altitude\n" + rows), times=[0, 30, 60])


def test_times_that_may_have_two_units_are_refused(refused):
    rows = "".join(f"{5000 * k},48.1,11.5,50\n" for k in range(5))
    line = refused(read_telemetry, "timestamp,lat,lon,relative_altitude\n" + rows)
    assert "steps by 5000, which may be milliseconds or microseconds; wanted a name with the unit" in line


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        (["05/08/2022 12:00:00", "05/08/2022 12:00:01"], "whether day or month comes first"),
        (["1970-01-01T00:00:00Z", "1970-01-01T00:00:01Z"], "shows the impossible year 1970"),
        (["2022-08-26 12:00:00", "2022-08-26 12:00:01"], "set aerial.time_zone"),
    ],
)
def test_a_clock_that_is_not_sure_is_none_and_a_note_says_why(fly, cells, words):
    flown = fly("timestamp,lat,lon,relative_altitude\n" + "".join(f"{cell},48.1,11.5,50\n" for cell in cells))
    check(flown, times=[0, 1], start=None)
    assert [note for note in flown.notes if words in note]


def test_of_several_clocks_the_finest_tells_the_seconds_and_that_in_utc_the_time(fly):
    text = table(
        "OSD.flyTime [s],datetime(local),datetime(utc),lat,lon,relative_altitude",
        "{i}.5,2022-08-26 05:00:00,2022-08-26 12:00:00,48,11,50",
    )
    check(fly(text), times=[0, 1, 2, 3], start=NOON_UTC_S)
    frozen = "".join(f"0,2022-08-26 12:00:0{k},48,11,50\n" for k in range(4))  # before the motors start
    check(fly("flyTime [s],datetime(utc),lat,lon,relative_altitude\n" + frozen), times=[0, 1, 2, 3], start=NOON_UTC_S)


@pytest.mark.parametrize("on", ["1", "True", "Recording", "true", "Y"])
@pytest.mark.parametrize(
    "name", ["isVideo", "isTakingVideo", "CAMERA.isVideo", "CUSTOM.isVideo", "Recording", "video_recording"]
)
def test_the_column_that_says_when_the_camera_records_tells_how_to_count_from_there(fly, name, on):
    off = {"1": "0", "True": "False", "Recording": "", "true": "false", "Y": "N"}[on]
    rows = "".join(f"{k},48.1,11.5,50,{on if k in (2, 3, 6) else off}\n" for k in range(8))
    (note,) = [note for note in fly(f"{PLACE},{name}\n{rows}").notes if "film" in note]
    assert "began to film 2.0 s after its first row and again at 6.0 s" in note and "aerial.clock_offset_s=-2.0" in note


# -- Places ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "cells", "place"),
    [
        ("lat,lon", "48.5 S,11.25W", (-11.25, -48.5)),
        ("lat,lon", "48.5°N,011.25°E", (11.25, 48.5)),
        ("latitude,N/S,longitude,E/W", "48.5,S,11.25,W", (-11.25, -48.5)),
        ("lat,lon", "485000000,112500000", (11.25, 48.5)),
        ("position", "111.25 48.5", (111.25, 48.5)),
        ("position", "48.5N 11.25E", (11.25, 48.5)),
        ("position", "11.25E 48.5N", (11.25, 48.5)),
        ("position", '"48°30\'00""N, 11°15\'00""W"', (-11.25, 48.5)),
        ("position", '"(48.5, 111.25)"', (111.25, 48.5)),
        ("position", '"48.5, 111.25, 540"', (111.25, 48.5)),
        ("latlon", '"48.5, 11.25"', (11.25, 48.5)),
        ("GPS lonlat", '"11.25, 48.5"', (11.25, 48.5)),
        ("lat,lat_ref,lon,lon_ref", "48.5,S,11.25,W", (-11.25, -48.5)),
        ("GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef", "48.5,South,11.25,West", (-11.25, -48.5)),
        ("latitude,latitude hemisphere,lon,lon hemisphere", "-48.5,S,11.25,E", (11.25, -48.5)),
        ("lat,lon", '"48 deg 30\' 0.00"" S","11 deg 15\' 0.00"" W"', (-11.25, -48.5)),
        ("lat,lon", "48500000,11250000", (11.25, 48.5)),
        ("lat_e6,lon_e6", "4850000,11250000", (11.25, 4.85)),
        ("lat_1e7,lon_1e7", "48500000,11250000", (1.125, 4.85)),
        ("lat,lon,gps_lat,gps_lon", "0,0,48.5,11.25", (11.25, 48.5)),
        ("lat,lon", "485000000,1112500000", (111.25, 48.5)),
        ("east_m,north_m", "3,4", (3, 4)),
    ],
)
def test_places_are_read_in_every_form(fly, names, cells, place):
    flown = fly(table(f"time_s,{names},relative_altitude", "{i}," + cells.replace("{", "") + ",50"))
    np.testing.assert_allclose(flown.place, [place] * 4)


def test_two_coordinates_in_one_cell_need_an_order_unless_the_program_or_a_value_tells_it(fly):
    text = table("time_s,position,relative_altitude", "{i},48.5 11.25,50")
    with pytest.raises(InputError, match=r"set aerial\.order=lat-lon or aerial\.order=lon-lat"):
        fly(text)
    assert fly(text, order="lat-lon").place[0].tolist() == [11.25, 48.5]
    assert fly(text, order="lon-lat").place[0].tolist() == [48.5, 11.25]


def test_rows_without_a_fix_have_no_place(fly):
    rows = "".join(f"{k},{k + 1},48.1,11.5,50\n" for k in range(4))
    flown = fly(f"time_s,fix_type,lat,lon,relative_altitude\n{rows}")
    assert np.isnan(flown.place[:, 0]).tolist() == [True, False, False, False] and flown.altitude_m[0] == 50


def test_nothing_is_known_between_two_flights_and_of_a_place_astray(fly):
    rows = "".join(f"{k},{48.1 + (k > 4)},11.5,{50 + k}\n" for k in range(10))
    flown = fly(f"{PLACE}\n{rows}")
    between, before, after = (flown.at(time_s) for time_s in (4.5, 3.5, 5.5))
    assert math.isnan(between.altitude_m) and math.isnan(between.place[1]) and math.isnan(between.speed_m_s)
    assert (before.place[1], after.place[1]) == pytest.approx((48.1, 49.1)) and before.altitude_m == 53.5
    assert [note for note in flown.notes if "jumps after 4.0 s: these are several flights" in note]
    assert not (flown.speed_m_s > 1).any()
    stray = fly(f"{PLACE}\n" + "".join(f"{k},{49.1 if k == 5 else 48.1},11.5,50\n" for k in range(12)))
    assert np.nanmax(stray.place[:, 1]) == 48.1 and stray.at(5.0).altitude_m == 50
    date_line = "".join(f"{k},10,{179.9999 + k * 1e-4 - 360 * (k > 1):.4f},50\n" for k in range(6))
    assert not [note for note in fly(f"{PLACE}\n{date_line}").notes if "flights" in note]


def test_flights_one_after_the_other_whose_times_run_back_are_told_apart_by_dates_or_refused(fly):
    rows = ["".join(f"{k}00,2022-08-26 1{h}:00:0{k},48.1,11.5,50\n" for k in range(9)) for h in (2, 3)]
    flown = fly("time(ms),datetime(utc),lat,lon,relative_altitude\n" + "".join(rows))
    assert math.isnan(flown.at(1800.0).altitude_m) and flown.time_s[-1] == 3608
    with pytest.raises(InputError, match=r"time runs back from 8\.000 to 0\.000 s; are these two recordings"):
        fly(f"{PLACE}\n" + "".join(f"{k % 9},48.1,11.5,50\n" for k in range(18)))


@pytest.mark.parametrize("count", [15, 20, 200])
@pytest.mark.parametrize("is_restarted", [False, True])
@pytest.mark.parametrize("away", [0, 1])
def test_flights_in_one_table_are_split_where_the_dates_jump(fly, count, is_restarted, away):
    rows = "".join(
        f"{k + h * count * (not is_restarted)}00,2022-08-26 {12 + h}:00:{k // 10:02d},{48.1 + h * away},11.5,{k}\n"
        for h in (0, 1)
        for k in range(count)
    )
    flown = fly("time(ms),datetime(utc),lat,lon,relative_altitude\n" + rows)
    assert [note for note in flown.notes if "these are several flights" in note]
    assert np.isfinite(flown.altitude_m).sum() == 2 * count and flown.start_utc_s == pytest.approx(NOON_UTC_S, abs=1)
    end_s = (count - 1) / 10
    assert math.isnan(flown.at(end_s + 0.05).altitude_m) and flown.at(end_s).altitude_m == pytest.approx(count - 1)
    assert flown.time_s[-1] == pytest.approx(3600 + end_s if is_restarted else 2 * end_s + 0.1, abs=1)


def test_a_later_flight_that_comes_first_is_sorted_by_its_dates(fly):
    rows = "".join(f"2022-08-26 {h}:00:0{k},{48.1 + h},11.5,{k}\n" for h in (13, 12) for k in range(9))
    flown = fly("datetime(utc),lat,lon,relative_altitude\n" + rows)
    assert (flown.time_s[0], flown.time_s[-1]) == (-3600, 8) and flown.start_utc_s == NOON_UTC_S + 3600
    assert flown.at(0.0).place[1] == pytest.approx(61.1) and flown.at(-3600.0).place[1] == pytest.approx(60.1)


def test_times_that_begin_again_elsewhere_go_on_and_the_flights_are_split(fly):
    flown = fly(f"{PLACE}\n" + "".join(f"{k % 9},{48.1 + (k > 8)},11.5,50\n" for k in range(18)))
    assert flown.time_s[-1] == 17 and flown.at(9.0).place[1] == pytest.approx(49.1)
    assert math.isnan(flown.at(8.5).altitude_m) and [note for note in flown.notes if "several flights" in note]


# -- Heights -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "cells", "wanted", "words"),
    [
        ("height", "50", {"altitude": 50, "zero": "takeoff"}, "where the height is zero; above the take-off point"),
        ("altitude", "50", {"altitude": None, "sea": 50, "zero": "unknown"}, "takeoff_above_sea_m = 0 in the camera"),
        ("height,altitude", "50,550", {"altitude": 50, "sea": 550}, "where the altitude is zero; above the sea"),
        ("height,altitude", "50,50", {"altitude": 50, "sea": None}, "where the height is zero"),
        ("relative altitude,altitude agl,altitude", "50,40,550", {"altitude": 50, "sea": 550}, "altitude agl"),
        ("altitude agl,height", "40,50", {"altitude": 40, "zero": "ground"}, "columns that are not used: height"),
        ("ellipsoidal height", "120", {"ellipsoid": 120, "sea": None, "altitude": None}, "count from the ellipsoid"),
        ("hae,undulation", "120,47", {"ellipsoid": 120, "sea": 73}, "minus the log's own height of the geoid"),
        ("altitude (m AMSL)", "550", {"sea": 550, "altitude": None}, "no altitude above ground"),
        ("GPS altitude (WGS84) [m]", "588", {"ellipsoid": 588, "sea": None}, "count from the ellipsoid"),
        ("Ellipsoidal altitude", "588", {"ellipsoid": 588, "sea": None}, "count from the ellipsoid"),
        ("GPS Altitude (AMSL) [ft]", "1804.462", {"sea": 550, "altitude": None}, "no altitude above ground"),
        ("altitude_asl", "550", {"sea": 550, "altitude": None}, "no altitude above ground"),
        ("elevation above sea level", "550", {"sea": 550}, "no altitude above ground"),
        ("HAGL", "45", {"altitude": 45, "zero": "ground"}, ""),
        ("ATO [m]", "45", {"altitude": 45, "zero": "takeoff"}, ""),
        ("altitude_rel", "45", {"altitude": 45, "zero": "takeoff"}, ""),
        ("height above take-off point (m)", "45", {"altitude": 45, "zero": "takeoff"}, ""),
        ("Relative Altitude / ft", "164.042", {"altitude": 50, "zero": "takeoff"}, ""),
        ("ele", "540", {"sea": 540, "zero": "unknown"}, "where the altitude is zero"),
        ("altitude (geopotential) [m]", "540", {"sea": None}, "columns that are not used: altitude (geopotential) [m]"),
        ("home altitude", "540", {"sea": None, "altitude": None}, "columns that are not used: home altitude"),
        ("z", "40", {"sea": None, "altitude": None}, "columns that are not used: z"),
        ("elevation", "540", {"sea": None, "altitude": None}, "columns that are not used: elevation"),
        ("rangefinder_distance", "40", {"altitude": None}, "columns that are not used: rangefinder_distance"),
        ("easting,northing", "691000,5334000", {"altitude": None}, "columns that are not used: easting, northing"),
        ("altitude (fathoms)", "550", {"sea": None, "altitude": None}, "columns that are not used: altitude (fathoms)"),
    ],
)
def test_four_heights_are_told_apart_and_what_is_assumed_is_noted(fly, names, cells, wanted, words):
    flown = fly(table(f"time_s,lat,lon,{names}", "{i},48.1,11.5," + cells))
    check(flown, **wanted)
    assert not words or [note for note in flown.notes if words in note], flown.notes
    assert words or not [note for note in flown.notes if "not used" in note]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gimbal_pitch", "-120", "pitch_deg is 120, which is impossible"),
        ("gimbal_yaw(rad)", "1e308", "heading_deg is inf, which is impossible"),
        ("hfov", "180", "hfov_deg is 180, which is impossible"),
        ("hfov", "0", "hfov_deg is 0, which is impossible"),
        ("speed", "900", "speed_m_s is 900, which is impossible"),
        ("relative_height", "50000", "above_takeoff_m is 50000, which is impossible"),
        ("speed", "fast", "speed is 'fast', which is not a number; 1 left out"),
    ],
)
def test_impossible_values_are_left_out_and_noted(fly, name, value, words):
    flown = fly(f"time_s,lat,lon,{name}\n0,48.1,11.5,{value}\n1,48.1,11.5,10\n2,48.1,11.5,10\n")
    assert [note for note in flown.notes if f"line 2: {words}" in note], flown.notes


@pytest.mark.parametrize(
    ("names", "cells", "words"),
    [
        ("gimbal_pitch", "-1.0472", "'gimbal_pitch' is -1.0472 to -1.0472, which may be radians: degrees are assumed"),
        ("gimbal_yaw", "1.5708", "'gimbal_yaw' is 1.5708 to 1.5708, which may be radians"),
        ("gimbal_yaw_rad", "1.5708", ""),
        ("gimbal_yaw [deg]", "1.5708", ""),
        ("gimbal_pitch", "-60.0", ""),
        ("gimbal_pitch", "0.0", ""),
    ],
)
def test_angles_that_may_be_radians_are_noted(fly, names, cells, words):
    notes = [note for note in fly(table(f"{PLACE},{names}", "{i},48.1,11.5,50," + cells)).notes if "radians" in note]
    assert bool(notes) == bool(words) and all(words in note for note in notes)
    assert not notes or fly(table(f"{PLACE},{names}", "{i},0.840151,0.202027,50," + cells)).notes[0].count("radians")


@pytest.mark.parametrize("unknown", ["", "N/A", "nan", "null", "No Data", "--"])
def test_words_for_nothing_are_nothing(fly, unknown):
    flown = fly(f"{PLACE},yaw\n0,48.1,11.5,50,{unknown}\n1,48.1,11.5,50,90\n")
    assert math.isnan(flown.vehicle_heading_rad[0]) and not [note for note in flown.notes if "number" in note]


def test_a_column_without_values_gives_way_to_another_name(fly):
    flown = fly(table("time_s,lat,lon,relative_altitude,height,gimbal_pitch,camera_pitch", "{i},48.1,11.5,,50,,-30"))
    check(flown, altitude=50, pitch=30)


# -- What a table is ---------------------------------------------------------------------------------------------------


def test_only_a_table_all_of_whose_columns_are_own_ones_is_an_own_table(fly):
    own = table("time_s,altitude_m,longitude_deg,latitude_deg,pitch_deg", "{i},50,11.5,48.1,60")
    check(fly(own), altitude=50, zero="ground", pitch=60)
    other = fly(own.replace("pitch_deg", "pitch_deg,battery").replace(",60\n", ",60,7\n"))
    check(other, altitude=None, sea=50, pitch=None)
    assert [note for note in other.notes if "own tables have no columns battery: read as another" in note]
    assert [note for note in other.notes if "columns that are not used: pitch_deg" in note]


@pytest.mark.parametrize(("before", "after"), [("", ","), ("", ",,"), (",", ""), ("Unnamed: 0,", "")])
def test_an_own_table_may_have_empty_columns_and_the_numbers_of_its_rows(fly, before, after):
    header = f"{before}time_s,altitude_m,longitude_deg,latitude_deg,pitch_deg{after}"
    row = f"{'{i},' if before else ''}{{i}},50,11.5,48.1,60{after}"
    check(fly(table(header, row)), altitude=50, zero="ground", pitch=60, sea=None)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (table("time(ms);lat;lon;abs_alt", "{i}.000;48,1371;11,5753;1.540,25"), {"sea": 1540.25, "latitude": 48.1371}),
        (table("time (s),lat,lon,abs_alt", '"{i},000","48,137","11,575","40,000"'), {"sea": 40, "latitude": 48.137}),
        (table("time_s  lat  lon  abs_alt", "{i}  48.1371 11.5753  40"), {"sea": 40, "latitude": 48.1371}),
    ],
)
def test_thousands_with_points_quoted_decimal_commas_and_blanks_between_cells_are_read(fly, text, wanted):
    check(fly(text), times=[0, 1, 2, 3], **wanted)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2014-01-01 12:00:00.123,FE,1C,mavlink_global_position_int_t,lat,481371000\n", "mavlogdump.py --format csv"),
        ("2022-08-26 18:12:47.00: GPS {TimeUS : 0, Lat : 48.1}\n", "mavlogdump.py --format csv"),
        ("latitude,longitude,rel_alt\n1,2,3\n", "lacks a time; its columns are latitude, longitude, rel_alt"),
        ("time_s,battery\n0,5\n1,5\n", "nothing in it (table of another program) holds a place"),
        (
            "time_s,x_px,y_px\n0,5,6\n1,5,6\n",
            "wanted some of the columns time_s, latitude_deg, longitude_deg, altitude_m",
        ),
        ("battery,voltage\n0,5\n1,5\n", "names none of time_s, altitude_m"),
        ("time_s,lat,lon\n", "has a header but no rows"),
        ("time_s,lat,lon\nx,1,2\ny,1,2\n", "line 2: 'x' is not a time"),
    ],
)
def test_a_table_of_no_use_is_refused_for_the_reason_that_is_true(refused, text, words):
    assert words in refused(read_telemetry, text)


def test_columns_that_look_like_telemetry_and_are_not_used_are_named(fly):
    flown = fly(table(f"{PLACE},camera tilt,HOME.latitude,battery,digitalZoom", "{i},48.1,11.5,50,1,2,3,4"))
    assert "columns that are not used: camera tilt, HOME.latitude, digitalZoom" in flown.notes


@pytest.mark.parametrize(
    ("title", "quantity", "scale"),
    [
        ("OSD.height [ft]", "bare_height_m", 0.3048),
        ("gb_yaw", "heading_rad", math.pi / 180),
        ("gimbalPitch_rad", "pitch_rad", -1),
        ("camera.pitch", "pitch_rad", -math.pi / 180),
        ("drone_yaw", "vehicle_heading_rad", math.pi / 180),
        ("Speed (km/h)", "speed_m_s", 1 / 3.6),
        ("speed_ms", "speed_m_s", 1),
        ("Height Above Takeoff (ft)", "above_takeoff_m", 0.3048),
        ("GPS Altitude", "above_sea_m", 1),
        ("gps_height", "bare_altitude_m", 1),
        ("H (m)", "above_takeoff_m", 1),
        ("H", None, 0),
        ("pitch", None, 0),
        ("home_latitude", None, 0),
        ("setpoint.yaw", None, 0),
        ("max_altitude(feet)", None, 0),
        ("speed (furlongs)", None, 0),
    ],
)
def test_a_name_is_known_with_and_without_prefix_and_unit(title, quantity, scale):
    known = Names().find(title)
    assert (known is None) == (quantity is None)
    if known is not None:
        assert known.field.quantity == quantity and known.scale == pytest.approx(scale)
