# SPDX-License-Identifier: Apache-2.0
"""An example for the help of each command; those with longer ones have them beside their options.

Apart from the table of commands, which every start reads: only help needs these.
"""

EXAMPLES = {
    "fk": "robocal fk --robot ur10 --joints-deg 90,0,0,0,0,0",
    "info": "robocal info docs/examples/measured.csv",
    "data": "robocal data ur10_tmac --out out/ur10 --part B",
    "identify": (
        "robocal identify --robot ur10 --data docs/examples/measured.csv --hold-out 0.5 "
        "--output out/calibrated.yaml"
    ),
    "replay": "robocal replay bags/demo_shift.mcap --robot kr150_r3100 --auto",
    "validate": (
        "robocal validate bags/demo_shift.mcap --robot kr150_r3100 --report out/validation"
    ),
    "history": "robocal history rollback --to previous --kind thermal --by Ada --reason 'worse'",
    "thermal calibrate-sensor": (
        "robocal thermal calibrate-sensor --robot kr150_r3100 --data sensor.csv "
        "--output sensor.yaml"
    ),
    "thermal identify": (
        "robocal thermal identify --robot kr150_r3100 --sensor sensor.yaml --cold cold.csv "
        "--warm warm.csv --check check.csv"
    ),
    "thermal learn-prior": (
        "robocal thermal learn-prior --robot kr150_r3100 --sensor sensor.yaml --cold cold.csv "
        "--warm history.csv --output prior.yaml"
    ),
    "thermal screen": (
        "robocal thermal screen --robot kr150_r3100 --sensor sensor.yaml --cold cold.csv "
        "--warm shift.csv --check check.csv"
    ),
    "thermal plan-poses": (
        "robocal thermal plan-poses --robot kr150_r3100 --sensor sensor.yaml --own warm.csv "
        "--output poses.csv"
    ),
    "correct-points": (
        "robocal correct-points --robot kr150_r3100 --model full.yaml --mount mount.json "
        "--data measured.csv --output part.csv"
    ),
    "tool beams": (
        "robocal tool beams --data beams.csv --radius-mm 2.5 --robot ur10 --station cell_1 "
        "--output laser.yaml"
    ),
    "tool station": ("robocal tool station --robot ur10 --robot-serial K7 --output laser.yaml"),
    "tool crossed": (
        "robocal tool crossed --events events.csv --joints joints.csv --robot ur10 "
        "--laser laser.yaml"
    ),
    "tool points": "robocal tool points --method four --data touches.csv",
    "tool parallel": (
        "robocal tool parallel --data sweeps.csv --up-mm 400 --down-mm 360 --x-mm 800"
    ),
    "tool export": "robocal tool export --tool tool.json --format kuka",
    "hand-eye sphere": (
        "robocal hand-eye sphere --poses poses.csv --profiles profiles --radius-mm 20 "
        "--z-grows towards"
    ),
    "hand-eye step": (
        "robocal hand-eye step --poses poses.csv --profiles profiles --target stairs.yaml "
        "--z-grows towards"
    ),
    "hand-eye line": (
        "robocal hand-eye line --poses poses.csv --profiles profiles --z-grows towards"
    ),
    "hand-eye tracker": (
        "robocal hand-eye tracker --robot p1r2p3 --poses poses.csv --profiles profiles "
        "--points tracker.csv --target target.yaml"
    ),
    "hand-eye camera": (
        "robocal hand-eye camera --poses poses.csv --images shots --board 9x6 --square-mm 25"
    ),
    "hand-eye joint": "robocal hand-eye joint --sphere sphere --line line --z-grows towards",
    "hand-eye check-plan": (
        "robocal hand-eye check-plan --target-kind sphere --radius-mm 20 "
        "--center-mm 837,-59,45 --poses planned.csv --mount mount.json --near-mm 10 --far-mm -10"
    ),
    "hand-eye verify": (
        "robocal hand-eye verify --result mount.json --target-kind line --poses poses.csv "
        "--profiles profiles --z-grows towards"
    ),
    "hand-eye export": (
        "robocal hand-eye export --result mount.json --format urdf --parent tool0 --child laser"
    ),
    "fixture": (
        "robocal fixture --robot kr150_r3100 --fixture plate.yaml --points now.csv "
        "--taught taught.csv --maker kuka --name BASE_DATA[3]"
    ),
    "iso9283": (
        "robocal iso9283 --data docs/examples/positions.csv --commanded P1=1200,0,900 "
        "--commanded P2=1400,-350,650"
    ),
    "joint-functions": "robocal joint-functions --robot full.yaml --output functions.csv",
    "import-ur": (
        "robocal import-ur --calibration calibration.conf --nominal urcontrol.conf "
        "--output my_ur.yaml"
    ),
    "import-urdf": "robocal import-urdf my_arm.urdf --output my_arm.yaml",
    "export-urdf": (
        "robocal export-urdf --robot full.yaml --into my_arm.urdf --output calibrated.urdf"
    ),
    "plc certificates": "robocal plc certificates /etc/robocal/plc --host 192.168.0.20",
    "plc user": "robocal plc user /etc/robocal/plc line_1 --role operator",
    "warm": "robocal warm",
}
